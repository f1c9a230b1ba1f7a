"""Networks and optimizers side by side: inference, stage records, comparison, costs."""
