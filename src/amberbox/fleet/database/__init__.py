"""The server's database: tables of all rooms, transactions, versions, one server per folder."""
