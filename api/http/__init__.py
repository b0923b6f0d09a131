"""The HTTP service, a folder for each kind of thing it answers with.

Beside the folders: parameters of requests, times and numbers in them, headers of answers, problems, and what the documentation
says of these.
"""
