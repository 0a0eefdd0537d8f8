"""The paper's tables of compensation, and ours beside them."""
