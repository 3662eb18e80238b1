"""Rules without structures, answered from the facts upwards with joins in a good order."""
