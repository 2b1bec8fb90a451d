"""Fit of tissue optics to photographs: light transport, its derivatives, the inverse problem, and the
exported asset.
"""
