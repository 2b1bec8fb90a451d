"""Virtual mouths, subjects and rigs: what simulated cameras look at."""
