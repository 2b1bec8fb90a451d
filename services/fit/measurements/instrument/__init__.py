"""The instrument as the photographs show it: gains, flare, moves of scan and photographs."""
