"""What the server does with a call, whatever transport it came by."""
