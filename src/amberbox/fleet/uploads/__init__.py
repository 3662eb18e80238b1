"""Journals that robots copy to the server: in pieces, resumable, verified, then confirmed."""
