"""Speed claims as scripts: `python -m benchmarks.NAME` prints a table with ratios measured in the same run."""
