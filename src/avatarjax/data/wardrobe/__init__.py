"""What avatars wear: cloth, hair and props grown around a body, their paint, and how they become one mesh."""
