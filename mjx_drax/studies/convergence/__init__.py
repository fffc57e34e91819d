"""Problems that a local method should converge on from one plain guess, beside IPOPT."""
