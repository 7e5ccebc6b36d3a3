"""REST: the contract's messages as JSON or protobuf over HTTP."""
