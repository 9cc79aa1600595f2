"""What UNICA is compared with (Tables 2 and C, D.1), built here and trained on the same data."""
