"""tormagd: a real-time haptic controller daemon for a magnetorheological-elastomer friction brake."""

__version__ = "0.1.0"
