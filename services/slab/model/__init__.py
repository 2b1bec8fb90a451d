"""The forward model of a slab: its dictionary of phase functions, the walk, single scattering, the rig."""
