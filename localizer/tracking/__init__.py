"""Processing of frames: reference rendering, localization, engine, motion, acceptance."""
