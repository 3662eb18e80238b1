"""The recorder: from the sources through the queue and the filters into the journals."""
