"""The tables and figures of UNICA, measured on finished runs and printed beside the paper's: see `__main__`."""
