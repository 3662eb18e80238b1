"""Show that two versions of Amberbox behave byte for byte alike, seen from outside."""
