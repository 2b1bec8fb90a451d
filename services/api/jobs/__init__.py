"""Jobs: their states, table, queue, history and times."""
