"""Many files at once: which are meant (`inputs`), what is made of each (`items`), and having it made (`run`)."""
