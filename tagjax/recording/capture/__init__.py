"""Recording from sensors: readers over the network, their emulators, cameras, and a recording that is written as it goes."""
