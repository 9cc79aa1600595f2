"""What UNICA is compared with (Table 2, D.1), built here on the same data: methods that are given the true skeleton."""
