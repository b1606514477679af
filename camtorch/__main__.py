"""`python -m camtorch` is the command `camtorch`."""

import sys

from camtorch.cli import main

sys.exit(main())
