"""What a reviewer asks for beyond table 3: sensitivity, paired analysis, equivalence, replication, aggregates, cost."""
