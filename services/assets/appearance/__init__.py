"""How measured teeth look: colours, colour differences, translucency, and shade against a laboratory's own guide."""
