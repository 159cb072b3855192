"""Published data sets in their authors' own formats: which objects, and how their cameras become spherical poses."""
