"""Ground control in the estimation: adjustment with it, and few photos that it places alone."""
