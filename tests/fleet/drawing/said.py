"""What drawings say in tests: the words of pages."""

from amberbox.fleet.pages.drawingwords import drawing_words

WORDS = drawing_words()
