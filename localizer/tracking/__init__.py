"""Processing of frames: reference rendering, localization, engine, motion filter, states."""
