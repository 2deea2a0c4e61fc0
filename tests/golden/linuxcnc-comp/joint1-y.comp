   -2e1	2.5E-1 0.5 an extra column
20.0 +.25 5e-1
