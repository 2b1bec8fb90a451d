"""Light transport: images of nested media under all lights at once, with their derivatives."""
