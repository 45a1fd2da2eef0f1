"""What is left when the model is right: noise of the wheels and of the body, learnt from the log."""
