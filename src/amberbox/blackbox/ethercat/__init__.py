"""EtherCAT: frames, process images and the health of a segment, live and from captures."""
