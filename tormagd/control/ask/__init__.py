"""What force is asked for, over the time ahead."""
