"""What is said of it: findings, what a log could not show, the amended model, page and figures."""
