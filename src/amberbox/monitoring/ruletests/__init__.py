"""Rule tests: what monitors make of given series, written as data beside them."""
