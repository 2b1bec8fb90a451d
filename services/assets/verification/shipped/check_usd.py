"""Prints version and findings of USD's own validators for one stage, as one line of JSON."""

import json
import sys

from pxr import Usd, UsdValidation

UNKNOWN_SHADER, OF_MATERIALX = "MissingShaderIdInRegistry", "shaderId 'ND_"
"""Finding on nodes of MaterialX, whose definitions the package from the index lacks; MaterialX's own check covers
them."""


def main() -> None:
    """Validate the stage that the first word names."""
    stage = Usd.Stage.Open(sys.argv[1])
    context = UsdValidation.ValidationContext(UsdValidation.ValidationRegistry().GetOrLoadAllValidators())
    findings = [
        f"{error.GetName()}: {error.GetMessage()}"
        for error in context.Validate(stage)
        if not (error.GetName() == UNKNOWN_SHADER and OF_MATERIALX in error.GetMessage())
    ]
    print(json.dumps({"version": ".".join(map(str, Usd.GetVersion())), "findings": findings}))


if __name__ == "__main__":
    main()
