"""Virtual mouths, subjects and rigs: the scenes of simulated cameras."""
