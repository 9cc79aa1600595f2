"""What moves by itself: springs, mass-spring-damper systems, cloth."""
