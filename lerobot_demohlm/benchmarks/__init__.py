"""What generating, loading, training and evaluating cost, each number as a ratio within one run."""
