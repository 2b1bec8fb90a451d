"""Assets opened by programs of others; ``make clients`` sets them up."""
