"""Prints version and findings of MaterialX's validation for one document, as one line of JSON."""

import json
import sys

import MaterialX


def main() -> None:
    """Validate the document that the first word names."""
    document, library = MaterialX.createDocument(), MaterialX.createDocument()
    MaterialX.loadLibraries(MaterialX.getDefaultDataLibraryFolders(), MaterialX.getDefaultDataSearchPath(), library)
    MaterialX.readFromXmlFile(document, sys.argv[1])
    document.setDataLibrary(library)
    is_valid, message = document.validate()
    findings = [] if is_valid else [line for line in message.splitlines() if line.strip()] or ["It is not valid."]
    print(json.dumps({"version": MaterialX.getVersionString(), "findings": findings}))


if __name__ == "__main__":
    main()
