"""Renders a few pixels of one scene by Mitsuba; prints version and findings as one line of JSON."""

import json
import runpy
import sys
from pathlib import Path

import mitsuba as mi
import numpy as np

SMALL = {"width_0": 4, "height_0": 4, "spp": 4}
"""Parameters of a scene with which a render takes a second: only whether anything comes out is looked at."""


def main() -> None:
    """Load and render the scene that the first word names."""
    file = Path(sys.argv[1])
    text = file.read_text(encoding="utf-8")
    mi.set_variant("llvm_ad_rgb" if "<rgb" in text or 'type="rgb"' in text else "llvm_ad_mono")
    mi.set_log_level(mi.LogLevel.Error)
    findings = []
    try:
        if (file.parent / "thin_boundary.py").is_file():
            runpy.run_path(str(file.parent / "thin_boundary.py"))["register"]()
        given = {name: value for name, value in SMALL.items() if f'<default name="{name}"' in text}
        scene = mi.load_file(str(file), optimize=False, **given)
        image = np.array(mi.render(scene, sensor=0, spp=SMALL["spp"]))
        if not np.isfinite(image).all():
            findings.append("The image holds values that are not finite.")
    except (RuntimeError, ValueError, ImportError) as problem:
        findings.append(" ".join(str(problem).split()))
    print(json.dumps({"version": mi.MI_VERSION, "findings": findings}))


if __name__ == "__main__":
    main()
