"""Work spread over processes: executors, the process that owns the renderer, fair shares, seeds, the journal."""
