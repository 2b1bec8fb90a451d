"""Phase functions, Fresnel, medium parameters and their fitting domain."""
