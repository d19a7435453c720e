"""Pages of finished cells: `results` reads them and knows the statistics, `tables` and `figures` show them, `page` puts them together."""
