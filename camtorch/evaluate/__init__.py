"""Which way a call takes: eager and native, recorded, exported."""
