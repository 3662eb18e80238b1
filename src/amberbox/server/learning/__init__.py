"""Models of detectors, learnt on the server from the missions of its robots."""
