"""From datasets to everything a trial needs: suite, tokenizer, token store, evaluation windows."""
