"""The page: `page` puts it together, with the tables of `overview` and the drawings of `svg`."""
