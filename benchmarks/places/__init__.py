"""Six places in six conditions at two heights: the paper's Table 2 with its rivals in one run."""
