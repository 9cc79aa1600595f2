"""Motion: clips, their retargeting, and controllers that turn keys into poses."""
