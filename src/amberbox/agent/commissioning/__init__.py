"""Commissioning: a first robot folder from what runs on a robot and from what its nodes say."""
