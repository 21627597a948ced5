"""The model: embed -> stems -> trunk -> heads, and what declares its parameters."""
