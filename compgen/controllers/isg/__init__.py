"""ISG kernel and Etalon exchange: error curves of all axes in one CSV (isg-csv, etalon-exchange)."""
