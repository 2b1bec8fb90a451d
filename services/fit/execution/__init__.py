"""How a fit runs: its steps, tasks over blocks of pixels, engines in processes, the journal."""
