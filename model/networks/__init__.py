"""The conditional variational autoencoder of Trajectron++, CAB, Reweight and RUBiZ."""
