"""tormagctl: the operator's command line. Talks to the daemon over ZeroMQ only."""
