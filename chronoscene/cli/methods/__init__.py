"""Commands on methods: listing, checking and beginning one."""
