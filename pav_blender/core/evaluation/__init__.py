"""How good a picture is, and the reports that say so."""
