"""From a camera's channels to colours, by a chart of patches."""
