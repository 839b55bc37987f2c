"""Search by Optuna. Its study is rebuilt from the runs of the store, which are its only memory."""
