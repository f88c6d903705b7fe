"""From a source to a tile cache: levels of detail, pools of workers, atomic publishing."""
