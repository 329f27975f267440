"""What tests, benchmarks and the fuzzer share."""
