"""The paper's experiments: runs that are kept, numbers from them, figures and a report."""
