"""The networks: the CVAE of Trajectron++, CAB, Reweight and RUBiZ, CoverNet, and their forecasters."""
