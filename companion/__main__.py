"""``python -m companion``."""

import sys

try:  # the imports take seconds, in which an operator may think better of it
    from companion.cli import main

    main()
except KeyboardInterrupt:
    sys.exit(130)
