"""The same project under several methods: what a comparison is made of."""
