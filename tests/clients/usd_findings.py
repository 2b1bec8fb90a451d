"""Program for the clients' Python: what UsdValidation finds in a USD file, or the ``materialx`` package in a document.

python usd_findings.py asset.usda
python usd_findings.py asset.mtlx
"""

from __future__ import annotations

import json
import sys


def usd(path: str) -> list[list[str]]:
    """Findings of all validators of ``usd-core``: validator, name, message."""
    from pxr import Usd, UsdValidation

    names = [data.name for data in UsdValidation.ValidationRegistry().GetAllValidatorMetadata()]
    context = UsdValidation.ValidationContext(UsdValidation.ValidationRegistry().GetOrLoadValidatorsByName(names))
    return [
        [error.GetValidator().GetMetadata().name, error.GetName(), error.GetMessage()]
        for error in context.Validate(Usd.Stage.Open(path))
    ]


def materialx(path: str) -> list[list[str]]:
    """Findings of MaterialX with its standard library, which says what inputs a shader has."""
    import MaterialX as mx  # noqa: N813

    document, library = mx.createDocument(), mx.createDocument()
    mx.loadLibraries(mx.getDefaultDataLibraryFolders(), mx.getDefaultDataSearchPath(), library)
    mx.readFromXmlFile(document, path)
    document.setDataLibrary(library)
    valid, message = document.validate()
    return [] if valid else [["materialx", "validate", message]]


print(json.dumps((usd if sys.argv[1].endswith(".usda") else materialx)(sys.argv[1])))
