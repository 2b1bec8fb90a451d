"""Execution of a fit: its steps, tasks over blocks of pixels, engines in processes, the journal."""
