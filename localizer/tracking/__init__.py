"""One frame's way: the two halves of the algorithm, the engine around them, motion, acceptance."""
