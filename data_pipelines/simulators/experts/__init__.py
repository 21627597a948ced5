"""Scripted experts, where a package ships none. Each looks at the state and names an action."""
