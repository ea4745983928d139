"""The commands: `python -m experiments.<command>`, configured by Hydra from conf/<command>.yaml."""

import sys

from tagjax.core.interruption import exit_on_signals

if (
    sys.argv[0] == "-m"
):  # Python is about to run `-m experiments.<command>`: nothing of the command has been imported yet
    exit_on_signals()
