"""Classical path followers: what DISCO is measured against, and what drives on when it finds no plan."""
