"""`python -m scsr_opt.cli`: the command without its entry point being installed."""

import sys

from scsr_opt.cli.app import main

sys.exit(main())
