"""Teeth as solids: scans, roots, frames by FDI number, average shapes, blend shapes of dentin, distances."""
