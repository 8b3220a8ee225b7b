"""MCAP files below the level of topics: records, chunks, blocks of messages."""
