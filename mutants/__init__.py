"""Small bugs, put into a copy of the code one at a time: whether the tests notice."""
