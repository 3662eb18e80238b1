"""Shared by routes of the API and pages: authentication, common parameters, and errors."""
