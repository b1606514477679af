"""`python -m camtorch` is the command `camtorch`."""

import sys

from camtorch.cli.main import main

sys.exit(main())
