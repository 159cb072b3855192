"""What is computed in order to be looked at: landscapes, fields, pairs with all that explains them."""
