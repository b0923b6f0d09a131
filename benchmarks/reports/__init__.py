"""The published reports of `skugga compare`, one for each kind of scene, and the page that compares them."""
