"""Jobs: their records, queue, history and times."""
