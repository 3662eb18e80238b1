"""What API and web pages share.

The running server's context, forms of answers, settings, metrics and health.
"""
