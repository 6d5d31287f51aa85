"""tormagctl: the operator's command line, which talks to the daemon over ZeroMQ only."""
