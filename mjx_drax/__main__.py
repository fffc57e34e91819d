"""`python -m mjx_drax` is `mjx-drax`."""

import sys

from mjx_drax.cli import main

sys.exit(main())
