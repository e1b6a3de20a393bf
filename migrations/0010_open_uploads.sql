-- How many uploads a key may have begun that are not complete; NULL: no limit of its own.
ALTER TABLE keys ADD COLUMN max_open_uploads INTEGER;
