"""Flight recorder: answered Predict calls as MCAP files, with scene updates for Foxglove beside them."""
