"""How robots are, for people to look at: cards, the tree of components, what changed when."""
