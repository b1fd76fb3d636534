"""What a motion must keep beside the limits of its joints."""
