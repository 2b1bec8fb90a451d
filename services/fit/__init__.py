"""Light transport, its derivatives, the inverse problem, and the exported asset."""
