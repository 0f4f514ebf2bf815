"""Parts of the twin that tests and benchmarks alone use: mirrors, wrong benches, line patterns."""
