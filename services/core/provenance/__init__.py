"""Where a result comes from and what a person has agreed to: inputs, versions, options, consent, lists of hashes."""
