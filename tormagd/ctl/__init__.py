"""tormagctl: the operator's command line. It talks to the daemon over ZeroMQ only."""
