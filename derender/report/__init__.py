"""What a person sees: tables, plots, HTML, exports."""
