"""What a test vector of a vendor's protocol says, against this project's codec and simulator; one file a vendor."""
