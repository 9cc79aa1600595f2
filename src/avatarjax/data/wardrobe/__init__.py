"""What avatars wear: cloth, hair and props grown around a body, their paint, and how they become one mesh.

Everything worn is a `garments.Piece`. It is made with `bones` (skinning weights), `paths` (lines and ropes), `ground`
and `drape` (lying on a body), `tailoring` (cutting, fitting, joining), `skin` (the body itself) and `fabrics`. Worn are
`bodice`, `coats`, `skirts`, `sleeves`, `capes`, `headwear`, `hair`, `footwear`, `belts`, `beads` and `backpacks`. Paint
is in `patterns` and `faces`, and the atlas in `textures`. `assembly` makes one painted mesh of all pieces.
"""
