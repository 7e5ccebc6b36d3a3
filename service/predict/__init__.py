"""One Predict call: decode, validate, recall, plan, batch, encode, remember."""
