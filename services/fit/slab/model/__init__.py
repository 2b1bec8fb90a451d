"""What a slab is and sends back: its dictionary of phase functions, the walk, single scattering, the rig."""
