"""The texture set of a tooth: colour, enamel thickness with its standard error, and stains, in one chart."""
