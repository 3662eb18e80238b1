"""Copy chosen items of a record to a database, as the paper's black box stored them."""
