"""The robot's end of the link: a reader of the journals that tells a server what they say."""
